"""Views of records: as text, as tables, as labelled datasets."""
