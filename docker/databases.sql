-- Beside that of the studies, which PostgreSQL's image makes by itself: the database of MLflow's server.
CREATE DATABASE mlflow;
