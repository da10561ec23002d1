"""The processes of the service: settings, start, supervision, logs, metrics, backup, checks."""
