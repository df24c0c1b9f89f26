from .comparisons import Comparison, run_comparisons
from .page import write_story_page

__all__ = ["Comparison", "run_comparisons", "write_story_page"]
