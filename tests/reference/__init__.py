"""Independent NumPy reference of the visual difference metric of Bolin and Meyer (1999).

Written from the paper alone: plain loops, float64, one function an equation. It shares no code with
the package under test and never imports torch. ``paper`` is the observer as printed, ``calibrated``
the same pipeline with the stages that the calibrated observer changes.
"""
