"""The paper that Barsight began from: each equation, figure, table and conclusion beside ours."""
