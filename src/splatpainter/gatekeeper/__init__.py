"""What stands between an edited picture and the asset: where it lies, what a program did to its colours, whether it is
an edit of this view at all."""
