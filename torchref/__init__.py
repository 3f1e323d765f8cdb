"""PyTorch twin of the kernels of `jaxrender`: a second implementation, written to be compared and read.

Every file here has the name, and every function the signature, of its partner in `jaxrender`; tensors stand
for arrays. The code follows the equations and not the partner: where the partner uses a table or a closed
form, this side integrates. Speed is no aim. `jax` is never imported here.

Precision: a kernel takes float32 or float64 (or float16 from a model file), works in float64 inside, and
hands back the dtype of its inputs. So in float32 it is the correctly rounded answer that the partner is
judged by. Options (`order`, `num_lobes`, ...) are Python numbers; a result that depends on options alone has
torch's default dtype.

Conventions are those of `jaxrender`: right-handed world, +Y up, metres, angles in radians; real orthonormal
spherical harmonics with the Condon-Shortley sign, index l(l+1)+m, `order` = number of bands; vertex-local
frame with z along the skinned normal.
"""
