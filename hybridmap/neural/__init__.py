"""Path integration cells: head direction -> band -> grid -> place -> place attractor; output are pose and place code."""

from hybridmap.neural.path_integrator import PathIntegrator

__all__ = ["PathIntegrator"]
