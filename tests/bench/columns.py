"""What every row of a benchmark holds."""

COLUMNS = {
    "what",
    "implementation",
    "batch",
    "threads",
    "compiled",
    "device",
    "median_us",
    "p95_us",
    "p99_us",
    "per_item_us",
    "max_error",
}
