"""Image filters in torch, window by window. One image at a time, (h, w, c)."""

from torchref.filters.guided import edge_aware_eps as edge_aware_eps
from torchref.filters.guided import guided_filter as guided_filter
from torchref.filters.sat import box_mean as box_mean
from torchref.filters.sat import box_sum_from_table as box_sum_from_table
from torchref.filters.sat import box_variance as box_variance
from torchref.filters.sat import summed_area_table as summed_area_table
from torchref.filters.valid import valid_pixels as valid_pixels
