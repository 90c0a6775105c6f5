/** A function that remembers its latest result, for as long as it is asked the same. */
export function rememberLatest<Args extends readonly unknown[], Result>(
  make: (...args: Args) => Result,
): (...args: Args) => Result {
  let latest: { args: Args; result: Result } | null = null;
  return (...args) => {
    if (!latest?.args.every((one, k) => one === args[k])) latest = { args, result: make(...args) };
    return latest.result;
  };
}
