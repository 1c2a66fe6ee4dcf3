"""The paper's tables and figures as lists of commands, run one after the other and taken up where they stopped."""
