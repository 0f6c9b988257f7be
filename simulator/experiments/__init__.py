"""The paper's figures and tables, and those beyond it: one file each, over flights that are flown once and kept."""
