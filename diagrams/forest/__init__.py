"""The forest: stands of trees, and maps of them with errors."""
