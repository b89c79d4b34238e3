"""Foundations: errors, settings, plain types, state dictionaries."""
