"""The pointwise pieces of ray tracing."""
