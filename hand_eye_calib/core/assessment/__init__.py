"""How good an answer is: metrics, covariance, observability."""
