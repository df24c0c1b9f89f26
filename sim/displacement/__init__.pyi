from .displace import Displacement, Patch, displace
from .measure import SignedDistance

__all__ = ["Displacement", "Patch", "SignedDistance", "displace"]
