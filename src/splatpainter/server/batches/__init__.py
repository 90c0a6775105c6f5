"""Batches that the page starts and watches."""
