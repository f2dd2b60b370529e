"""Baselines of single-view reconstruction (Table 2): docs/baselines_single_view.md."""
