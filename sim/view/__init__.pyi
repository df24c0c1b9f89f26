from .glb import write_glb
from .view import View, is_pair, view_folder, view_scenario
from .viewer import running_server, write_html

__all__ = [
    "View",
    "is_pair",
    "running_server",
    "view_folder",
    "view_scenario",
    "write_glb",
    "write_html",
]
