"""Episodes, solvability, sweeps, tables and plots."""
