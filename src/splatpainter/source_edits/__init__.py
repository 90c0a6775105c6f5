"""Edits made by picture sources: a view is rendered and sent, what comes back is admitted and painted; or views one
after the other until the surface is covered."""
