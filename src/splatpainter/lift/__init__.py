"""The analytic lift: an edited picture written onto the rows that make it, with no weights at all."""
