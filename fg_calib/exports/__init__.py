"""The calibrated arm as others read it: one module a format, and the door to all of them."""
