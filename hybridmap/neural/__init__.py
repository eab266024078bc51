"""The spatial cells: head direction -> band -> grid -> place -> place attractor; self-motion in, pose and place code out."""

from hybridmap.neural.path_integrator import PathIntegrator

__all__ = ["PathIntegrator"]
