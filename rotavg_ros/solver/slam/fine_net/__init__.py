"""FineNet of robots' graphs: predicts the error variance of each edge from evidence on its neighbourhood."""
