"""Training of the pose-to-visibility model: bake, fit, evaluate, report, relight."""

from jaxrender.machine import keep_xla_to_one_thread as _keep_xla_to_one_thread

# Importing jaxrender makes no array, so the switch is in time unless the caller has used JAX before.
_keep_xla_to_one_thread()
