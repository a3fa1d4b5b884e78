"""Baselines: what others do instead of exact blur, to compare with and to train networks that repair it.

Image-space filters, on batches of images, each importing only from those before it: views, gather, directional,
mcguire2012, guertin2014, curves, guertin2015, filters. Shadows: shadow_rays, shadow_maps, shadow_samples, shadows_tsm,
shadows_hong2018.
"""
