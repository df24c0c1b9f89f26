from .answer import Answer, read_answer, write_answer, write_failure
from .readers import RecordedScans, open_session
from .session import ScanChunk, Session, SessionWriter, read_session

__all__ = [
    "Answer",
    "RecordedScans",
    "ScanChunk",
    "Session",
    "SessionWriter",
    "open_session",
    "read_answer",
    "read_session",
    "write_answer",
    "write_failure",
]
