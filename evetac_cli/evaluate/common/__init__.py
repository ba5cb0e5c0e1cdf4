"""What subjects of `evaluate` share: report files, their origin, rows, pictures and the paper's figures."""
