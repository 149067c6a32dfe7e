"""Design rules: limits, measurements, repair, routing and reports."""
