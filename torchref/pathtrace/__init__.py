"""The kernels of path tracing in torch: light at a point, surfaces, emitters, sampling, and lookups by similarity."""
