"""Random valid cases under stress: stated errors and verdicts beside independent integrations."""
