//! Linear output-error models: free-run least squares with offset and stable poles.
