"""What each descriptor recognises and costs."""
