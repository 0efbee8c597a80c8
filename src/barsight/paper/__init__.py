"""The paper on which Barsight is based: each equation, figure, table and conclusion next to our result."""
