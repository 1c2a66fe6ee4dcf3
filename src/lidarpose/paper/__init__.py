"""The paper's tables and figures as lists of commands, which are run one after the other and can be resumed."""
