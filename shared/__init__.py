"""Code and formats that the edge service and its clients share."""
