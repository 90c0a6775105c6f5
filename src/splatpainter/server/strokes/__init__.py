"""Strokes while they are drawn: what the page sees before they are layers."""
