"""What speaks for and against a solution: certificates, consistency of loops, edges of little weight."""
