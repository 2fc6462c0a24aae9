"""A report for people: one HTML file without network, and its twin in Markdown."""

from herglotz.report.write import write_report as write_report
