"""What is damaged: one module a kind, each with ``make(seed) -> Case`` (see ``pool``)."""
