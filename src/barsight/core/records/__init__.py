"""Define the records that are passed between the stages: frozen, with shape, unit and frame per field.

The frames are `yard` (or `world`), `body` (the IMU), `cam0`, `cam1` (raw cameras), `rect0` (the left camera
after rectification) and `crane`; docs/reference/conventions.md defines them. No match and no depth are NaN.
"""
