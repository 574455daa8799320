"""Importing this keeps the process on one core. To be imported before JAX and torch count cores."""

import os

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
