"""Image filters in torch, window by window. One image at a time, (h, w, c)."""

from torchref.filters.albedo import demodulate as demodulate
from torchref.filters.albedo import remodulate as remodulate
from torchref.filters.atrous import atrous_filter as atrous_filter
from torchref.filters.bilateral import cross_bilateral_filter as cross_bilateral_filter
from torchref.filters.cross_validation import leave_one_out_error as leave_one_out_error
from torchref.filters.cross_validation import own_share as own_share
from torchref.filters.fireflies import clamp_fireflies as clamp_fireflies
from torchref.filters.guided import edge_aware_eps as edge_aware_eps
from torchref.filters.guided import guided_filter as guided_filter
from torchref.filters.sat import box_mean as box_mean
from torchref.filters.sat import box_sum_from_table as box_sum_from_table
from torchref.filters.sat import box_variance as box_variance
from torchref.filters.sat import summed_area_table as summed_area_table
from torchref.filters.valid import valid_pixels as valid_pixels
