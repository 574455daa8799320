"""Pictures of what was learned: the report page."""
