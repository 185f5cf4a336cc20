"""Campaigns: from a table of exams to their maps, sizes and pages, and to the trial's report."""
