"""From the scans of one session to a thinned map with keyframes and the free space around them."""
