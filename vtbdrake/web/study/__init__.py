"""The page of a study: its points, its surrogate, its rollouts, and what a person changes in its search."""
