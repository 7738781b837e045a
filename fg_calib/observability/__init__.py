"""Which parameters measurements determine, and why not the others."""
