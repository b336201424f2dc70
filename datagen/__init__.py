"""Offline datasets of meta-environments: `datagen.dataset` is the format, the rest collects it.

Nothing is imported here, so that reading a dataset loads neither torch nor Stable-Baselines3.
"""
