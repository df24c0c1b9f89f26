from .picture import save_picture
from .scenario import Draft, draft_scenario, format_scenario
from .tracing import Trace, trace_mesh

__all__ = ["Draft", "Trace", "draft_scenario", "format_scenario", "save_picture", "trace_mesh"]
