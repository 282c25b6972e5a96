-- The database of MLflow's server; PostgreSQL's image itself creates the one of the studies.
CREATE DATABASE mlflow;
