"""Path tracing with filtered indirect light, and the rays it is made of."""

from jaxrender.pathtrace.bvh import Bvh as Bvh
from jaxrender.pathtrace.bvh import build_bvh as build_bvh
from jaxrender.pathtrace.bvh import refit_bvh as refit_bvh
from jaxrender.pathtrace.bvh import update_bvh as update_bvh
from jaxrender.pathtrace.embree import EmbreeScene as EmbreeScene
from jaxrender.pathtrace.guide_lookup import guide_lookup as guide_lookup
from jaxrender.pathtrace.guide_rays import Traced as Traced
from jaxrender.pathtrace.hits import Hits as Hits
from jaxrender.pathtrace.instances import build_instances as build_instances
from jaxrender.pathtrace.instances import move_instances as move_instances
from jaxrender.pathtrace.ray_offset import offset_origin as offset_origin
from jaxrender.pathtrace.rays import trace_rays as trace_rays
from jaxrender.pathtrace.render import Rendered as Rendered
from jaxrender.pathtrace.render import render as render
from jaxrender.pathtrace.render import render_direct as render_direct
from jaxrender.pathtrace.render import render_indirect as render_indirect
from jaxrender.pathtrace.settings import TraceSettings as TraceSettings
from jaxrender.pathtrace.world import World as World
from jaxrender.pathtrace.world import move as move
from jaxrender.pathtrace.world import prepare as prepare
