// Files of the page: embedded in it, or beside it.

// A file's content as a ReadableStream of bytes.
export async function asset(name) {
    const element = document.getElementById(`asset:${name}`);
    if (element !== null) {
        const text = atob(element.textContent.trim());
        const bytes = new Uint8Array(text.length);
        for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
        return new Blob([bytes]).stream();
    }
    const response = await fetch(new URL(name, document.baseURI));
    if (!response.ok || response.body === null) {
        throw new Error(`${name}: expected a file beside this page, got HTTP ${response.status}`);
    }
    return response.body;
}

// A file's content as text.
export async function assetText(name) {
    return new Response(await asset(name)).text();
}
