"""Results as text, documents and figures."""
