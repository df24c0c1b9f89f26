from .captures import Recording, Revolution, open_recording
from .osf import write_osf
from .recording import Imported, import_recording

__all__ = [
    "Imported",
    "Recording",
    "Revolution",
    "import_recording",
    "open_recording",
    "write_osf",
]
