"""Of which class each closure's error is, by what all else says of it: whether it joins the right places."""
