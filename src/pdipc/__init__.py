"""Penetration-free projective dynamics for soft bodies and cloth (Lan et al., SIGGRAPH 2022) on NVIDIA Warp."""

import warp as _warp

_warp.config.log_level = _warp.LOG_WARNING
