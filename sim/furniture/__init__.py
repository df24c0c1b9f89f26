"""What is fixed to the rock in both sessions: pipes, ducts, cable trays, rock support, loose stones."""
