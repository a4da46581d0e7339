"""Pictures: force traces, rendered scenes and films."""
