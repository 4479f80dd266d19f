"""Targets of one kind of object each: contacts, tendons."""
