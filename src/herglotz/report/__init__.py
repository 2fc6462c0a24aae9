"""The report of a run: one HTML file that needs no network, and the same text in Markdown."""

from herglotz.report.write import write_report as write_report
