"""Sensor recordings, read (OSF, PCAP) and written (OSF) with the vendor's SDK, the extra `ouster`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
