"""One file per asset format, and the parts that formats share."""
