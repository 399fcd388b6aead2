//! An incremental encoder: position to counts.
