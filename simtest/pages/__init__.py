"""What every page is made of: style, cards, tables, charts, templates."""
