"""Bootstrap intervals and aggregation over seeds."""
