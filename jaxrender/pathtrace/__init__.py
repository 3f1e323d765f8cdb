"""Path tracing with filtered indirect light, and the rays it is made of."""

from jaxrender.pathtrace.guide_lookup import guide_lookup as guide_lookup
from jaxrender.pathtrace.guide_rays import Traced as Traced
from jaxrender.pathtrace.render import Rendered as Rendered
from jaxrender.pathtrace.render import render as render
from jaxrender.pathtrace.render import render_direct as render_direct
from jaxrender.pathtrace.render import render_indirect as render_indirect
from jaxrender.pathtrace.settings import TraceSettings as TraceSettings
from jaxrender.pathtrace.world import World as World
from jaxrender.pathtrace.world import prepare as prepare
