"""Studies: many runs, searched by Optuna with workers that wait for nobody, and judged on seeds that chose nothing."""
