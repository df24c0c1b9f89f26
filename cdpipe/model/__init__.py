"""What passes between the stages: the data types, the settings and the alignment of two sessions."""
