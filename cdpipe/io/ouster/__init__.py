"""Reading a sensor's own recording, OSF or PCAP, and writing OSF, with the vendor's SDK (extra `ouster`)."""
