"""Image filters guided by other images; they know nothing of scenes. One image at a time, (h, w, c)."""

from jaxrender.filters.albedo import demodulate as demodulate
from jaxrender.filters.albedo import remodulate as remodulate
from jaxrender.filters.aovs import Aovs as Aovs
from jaxrender.filters.atrous import atrous_filter as atrous_filter
from jaxrender.filters.bands import guided_filter_in_bands as guided_filter_in_bands
from jaxrender.filters.bands import in_bands as in_bands
from jaxrender.filters.bilateral import cross_bilateral_filter as cross_bilateral_filter
from jaxrender.filters.cross_validation import leave_one_out_error as leave_one_out_error
from jaxrender.filters.cross_validation import own_share as own_share
from jaxrender.filters.denoiser import Denoised as Denoised
from jaxrender.filters.denoiser import denoise as denoise
from jaxrender.filters.fireflies import clamp_fireflies as clamp_fireflies
from jaxrender.filters.guided import edge_aware_eps as edge_aware_eps
from jaxrender.filters.guided import guided_filter as guided_filter
from jaxrender.filters.sat import box_mean as box_mean
from jaxrender.filters.sat import box_sum_from_table as box_sum_from_table
from jaxrender.filters.sat import box_variance as box_variance
from jaxrender.filters.sat import summed_area_table as summed_area_table
from jaxrender.filters.settings import DenoiseSettings as DenoiseSettings
from jaxrender.filters.valid import valid_pixels as valid_pixels
