"""Build the height surface: election among each cell's heights, hole filling, contours, cloud."""
