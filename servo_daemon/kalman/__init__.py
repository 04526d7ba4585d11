"""The extended Kalman filter of a plant, compiled and as FilterPy's.

States, parameters, innovations; nothing else.
"""
