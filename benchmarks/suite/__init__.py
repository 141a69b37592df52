"""What asv follows from commit to commit: the numbers of `livepde bench`, ratios all of them."""
