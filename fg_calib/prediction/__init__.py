"""What the tool will miss by, and what to command."""
