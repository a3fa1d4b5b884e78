"""Baselines: what others do instead of exact blur, to compare with and to train networks that repair it."""
