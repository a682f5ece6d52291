"""Many frames of several tests against their reference: figures, comparisons, a report."""
