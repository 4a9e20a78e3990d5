"""Suites of photo collections and scans."""
