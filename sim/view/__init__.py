"""Looking at worlds and sessions: named surfaces and points, in the browser or as pictures."""
