"""A local edit without a surface: which Gaussians a view reaches, their splitting, their colours."""
