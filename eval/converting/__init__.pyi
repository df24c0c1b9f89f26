from .formats import FORMATS, OutFormat, choose_format
from .request import Request
from .writing import write_answer_map, write_session, write_world

__all__ = ["FORMATS", "OutFormat", "Request", "choose_format", "write_answer_map", "write_session", "write_world"]
