"""Which effects a scene calls for, and why: judged on pixels that did not choose their coefficients."""
