"""Charts of the results, one file for each result file that has some; `gscodec chart` draws them."""
