"""The deferred room in torch: every triangle against every sample, one after another."""
