"""The paper's figures and its Table 1, with our software, on lenses whose truth is known."""
