"""MLflow UI and Optuna dashboard, started together."""
