"""Studies: hyperparameter search by asynchronous Optuna workers, and a final evaluation with fresh seeds."""
