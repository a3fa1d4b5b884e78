"""Compiled twins of torchblur's stages for tensors on the CPU. No logic here."""
