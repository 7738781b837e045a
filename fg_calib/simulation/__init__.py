"""Scenarios, and the measurements that they make."""
