"""Reports for people: one page and its pictures about a run."""

from rotavg_ros.reports.report import ReportError, write_report

__all__ = ["ReportError", "write_report"]
