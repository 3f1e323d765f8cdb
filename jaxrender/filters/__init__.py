"""Image filters guided by other images; they know nothing of scenes. One image at a time, (h, w, c)."""

from jaxrender.filters.bands import guided_filter_in_bands as guided_filter_in_bands
from jaxrender.filters.bands import in_bands as in_bands
from jaxrender.filters.guided import edge_aware_eps as edge_aware_eps
from jaxrender.filters.guided import guided_filter as guided_filter
from jaxrender.filters.sat import box_mean as box_mean
from jaxrender.filters.sat import box_sum_from_table as box_sum_from_table
from jaxrender.filters.sat import box_variance as box_variance
from jaxrender.filters.sat import summed_area_table as summed_area_table
from jaxrender.filters.valid import valid_pixels as valid_pixels
