"""Fixtures of both sessions, never a change: pipes, ducts, cable trays, rock support, loose stones."""
