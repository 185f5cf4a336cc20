"""Estimation from map files: choice of calibration and options, estimate and report, shared by all callers."""

from __future__ import annotations
