"""The paper's tables and figures, computed again: data first, drawing and page second."""
