"""FineNet of robots' graphs: how far each edge errs here, by what the whole graph says of it and its neighbours."""
