"""Rivals as an expert would write them; each solves the very problem that sewfast is timed on."""
