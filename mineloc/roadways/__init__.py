"""The roadways of a mine: free space, centre-lines, the graph that they make."""
