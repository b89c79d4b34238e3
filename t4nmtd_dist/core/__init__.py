"""What everything else stands on: errors, settings, plain types, state dictionaries."""
