"""Simulated tasks and the scripted experts that record them."""
