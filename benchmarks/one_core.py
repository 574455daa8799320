"""Pins the process to one core. Import it before JAX and torch, which count cores."""

import os

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
