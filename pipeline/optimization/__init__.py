"""Optimization kernels: least squares, importance sampling, forward-mode derivatives, uncertainty of estimates."""
